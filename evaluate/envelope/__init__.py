"""The verified envelope of the gate, and the proof of the gate on it. Simulation."""
