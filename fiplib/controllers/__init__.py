"""Controllers beside the MPC, and the linear analysis of their closed loop."""
