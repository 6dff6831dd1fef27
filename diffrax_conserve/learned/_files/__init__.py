"""Networks in files."""

from .pretrained import load_pretrained as load_pretrained
from .pretrained import pretrained_path as pretrained_path
from .save import load as load
from .save import read_info as read_info
from .save import save as save
