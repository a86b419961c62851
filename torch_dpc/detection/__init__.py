"""The defender: is a measured window one that this system produces?"""

from .consistency import ConsistencyDetector, WindowStatistic
from .cusum import Cusum

__all__ = ["ConsistencyDetector", "Cusum", "WindowStatistic"]
