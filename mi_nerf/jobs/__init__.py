"""Lists of independent jobs, done by other processes of this machine or by a cluster."""

from .executors import open_executor
from .permit import Permit, permitted
from .process import JobError
from .run import Job, run_jobs, together

__all__ = ["Job", "JobError", "Permit", "open_executor", "permitted", "run_jobs", "together"]
