"""The papers' algorithms as policies, reference estimators and bounds, and Monte Carlo evaluation."""
