"""Files from untrusted senders: checked before anything reads them."""
