"""Controllers: waypoints, speeds and a controller matrix -> steering angle and acceleration."""
