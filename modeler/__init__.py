"""Models of objects from depth-camera sequences, with registration uncertainty that is tested to be true."""
