"""What comes from strangers: uploads, checked before anything reads them."""
