"""From a camera, a recording or a folder to one clean RGB-D frame."""
