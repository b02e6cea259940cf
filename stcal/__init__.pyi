from . import errors as errors
from . import handeye as handeye
from . import locate as locate
from . import register as register
from . import robot as robot
from . import sfm as sfm
from . import synthetic as synthetic
from .boards.file import load_board as load_board
from .boards.file import save_board as save_board
from .boards.target import load_target as load_target
from .boards.target import save_target as save_target
from .design import BoardDesign as BoardDesign
from .design import FaceDesign as FaceDesign
from .design import TargetDesign as TargetDesign
from .design import reference_board as reference_board
from .design import reference_target as reference_target
from .drawing.draw import draw as draw
from .errors import InputError as InputError
from .errors import StcalError as StcalError
from .geometry.camera import Camera as Camera
from .geometry.rigid import Poses as Poses
from .geometry.rigid import Rigid as Rigid
from .io.cameras.model import CameraPrior as CameraPrior
from .io.cameras.model import camera_prior as camera_prior
from .io.cameras.read import load_camera as load_camera
from .io.cameras.write import save_camera as save_camera

__version__: str
