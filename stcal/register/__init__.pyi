from .registered import Alternative as Alternative
from .registered import HeldOutPoints as HeldOutPoints
from .registered import Pairs as Pairs
from .registered import Registration as Registration
from .registered import read_pairs as read_pairs
from .registration import Liu2017Options as Liu2017Options
from .registration import register as register
