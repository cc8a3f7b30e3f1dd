"""Serve a bundle behind the safety gate over HTTP: `python -m serve`."""
