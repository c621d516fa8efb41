"""What needs torch and Ultralytics: exports of networks (extra `train`)."""
