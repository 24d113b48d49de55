"""An environment of one's own as a package: attitude from an inertial and magnetic sensor.

    filtergym list attitude:broad/Attitude-v0
    filtergym evaluate attitude:broad/Attitude-v0 --policy madgwick --policy mahony --policy vqf --episodes 50

Imported, it registers itself.
"""

import filtergym

from .baselines import BASELINES
from .task import Attitude

filtergym.register_task(Attitude, BASELINES)
