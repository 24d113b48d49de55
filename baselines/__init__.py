"""The papers' algorithms as policies, reference estimators and bounds; their tuning; their reproductions."""
