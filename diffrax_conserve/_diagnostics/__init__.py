from .check_invariance import InvarianceEntry as InvarianceEntry
from .check_invariance import InvarianceReport as InvarianceReport
from .check_invariance import check_invariance as check_invariance
from .drift import drift as drift
