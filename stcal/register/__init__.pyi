from .liu2017 import Liu2017Options as Liu2017Options
from .point_pairs import Pairs as Pairs
from .point_pairs import read_pairs as read_pairs
from .registered import Alternative as Alternative
from .registered import HeldOutPoints as HeldOutPoints
from .registered import Registration as Registration
from .registration import register as register
