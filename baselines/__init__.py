"""The papers' algorithms as policies, reference estimators and bounds, and their tuning."""
