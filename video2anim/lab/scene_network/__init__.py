"""Training of the room network: depth, normals, camera, classes and instances of a picture, in one encoder."""
