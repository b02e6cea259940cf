from .dataset import render_all as render_all
from .dataset import write_dataset as write_dataset
from .render import RenderOptions as RenderOptions
from .scene import Scene as Scene
from .scene import SceneOptions as SceneOptions
from .scene import make_scene as make_scene
