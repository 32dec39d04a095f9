"""The human body: SMPL-order skeleton and the body models that give it bones and a surface."""
