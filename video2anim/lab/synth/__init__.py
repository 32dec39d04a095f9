"""A synthetic world with known truth: rooms, people, cameras, pictures and the labels of all of it."""
