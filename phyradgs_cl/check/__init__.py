"""Finds what is wrong or suspicious in a scan before a reconstruction. ``run.py`` asks the questions of all modules here."""

from phyradgs_cl.check.detector import CountReader
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.orbit import CENTRE
from phyradgs_cl.check.run import CheckResult, check

__all__ = ["CANNOT_TELL", "CENTRE", "OK", "SUSPICIOUS", "CheckResult", "CountReader", "Finding", "check"]
