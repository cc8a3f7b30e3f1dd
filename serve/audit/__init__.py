"""What the car was asked, decided and refused, kept so that a change shows."""
