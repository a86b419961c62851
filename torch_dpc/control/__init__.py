"""The controller, its fallbacks, and the closed loop."""
