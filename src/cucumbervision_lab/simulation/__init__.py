"""Simulated houses and rounds of known truth."""
