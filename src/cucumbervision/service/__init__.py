"""The measurer over HTTP: captures in, rows out; and a client for it."""
