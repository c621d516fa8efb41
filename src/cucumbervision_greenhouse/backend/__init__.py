"""What the capture page and the dashboard share: the store, work, cameras, pictures, words."""
