"""What makes a fusion of LooselyCoupledNavigation costly: outages, jamming, spoofing, unreported noise, outliers."""

from ..contract.faults import causes_of
from .disturbances import DISTURBANCES

CAUSES = causes_of(DISTURBANCES)
