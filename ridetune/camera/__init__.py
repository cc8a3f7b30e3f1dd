"""The synthetic front camera: scenes with known content and their pictures."""
