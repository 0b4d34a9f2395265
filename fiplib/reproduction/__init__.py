"""The numbers of the paper, measured on recorded flights: claims, figures, tables."""
