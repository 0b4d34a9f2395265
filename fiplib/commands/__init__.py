"""Subcommands of ``fip`` that belong to no other room: recorded flights, figures and tables."""
