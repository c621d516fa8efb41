"""How well the networks see: boxes, masks, keypoints, and what their errors cost in length."""
