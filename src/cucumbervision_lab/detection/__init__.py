"""How well fruit are detected, outlined and measured from pictures."""
