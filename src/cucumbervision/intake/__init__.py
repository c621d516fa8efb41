"""Check files from untrusted senders before they are read."""
