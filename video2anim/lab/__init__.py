"""The laboratory: synthetic world, evaluation, training of the networks. Never on the path of `run`."""
