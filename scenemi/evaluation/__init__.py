"""Evaluation of in-betweening priors by the paper's protocols."""
