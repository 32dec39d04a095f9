"""Fitting the body to picture landmarks over time: initial guess, objective, optimiser, ground and contacts."""
