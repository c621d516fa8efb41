"""The measuring methods, one file each, and the selector among them. No files here."""
