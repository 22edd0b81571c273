"""Files of models: whole, readable without unpickling, and a start for other models."""
