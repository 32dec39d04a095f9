"""One fit of camera, people's sizes, floor, depth and objects' distances."""
