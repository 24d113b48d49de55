"""One module for each environment: its policies, reference estimators and bounds."""
