"""What training says of itself: logged figures, what is shown of them, and a report of a run."""
