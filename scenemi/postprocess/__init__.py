"""What is done to a motion after the prior: one least-squares solve of the body in its scene."""
