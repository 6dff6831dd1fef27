"""Networks in files."""

from ._pretrained import load_pretrained as load_pretrained
from ._pretrained import pretrained_path as pretrained_path
from ._save import load as load
from ._save import read_info as read_info
from ._save import save as save
