"""Fitting the body to image landmarks over time: initial guess, objective, optimizer, ground and contacts."""
