"""Classic factorisations of images of one object into cameras and shapes, without a network."""
