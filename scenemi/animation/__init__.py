"""What animators ask for: partial keyframes, postures at objects."""
