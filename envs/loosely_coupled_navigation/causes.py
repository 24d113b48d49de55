"""Causes of cost in LooselyCoupledNavigation: outages, jamming, spoofing, unreported noise, outliers."""

from ..contract.faults import causes_of
from .disturbances import DISTURBANCES

CAUSES = causes_of(DISTURBANCES)
