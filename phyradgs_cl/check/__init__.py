"""What is wrong or suspicious in a scan, before anyone waits for a reconstruction: one file per question."""

from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.questions.saturation import CountReader
from phyradgs_cl.check.run import CheckResult, check

__all__ = ["CANNOT_TELL", "OK", "SUSPICIOUS", "CheckResult", "CountReader", "Finding", "check"]
