"""Score a served bundle on held-out phrasings and unseen frames: `python -m evaluate`."""
