"""The model annotator: asks a vision model for the words of proposals, within a cost."""
