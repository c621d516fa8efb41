"""The methods measured on simulated captures of known length."""
