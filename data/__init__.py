"""Build the image-instruction-action dataset: `python -m data`."""
