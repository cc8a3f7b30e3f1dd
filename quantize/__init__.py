"""Merged model -> 4-bit AWQ checkpoint -> bundle for the car."""
