"""One module for each environment: how an episode is drawn."""
