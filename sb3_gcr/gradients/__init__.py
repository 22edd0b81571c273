"""One gradient per component, and their Gramian."""
