"""From a picture to the fruit in it: runtimes, YOLO26, SAM and the model registry."""
