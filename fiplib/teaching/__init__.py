"""Notebooks: what they share, the exercises, the page that explores a bag, the animation of a flight."""
