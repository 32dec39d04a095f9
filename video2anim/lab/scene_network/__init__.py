"""Training of the room network: depth, normals, camera, classes and instances of an image from one encoder."""
