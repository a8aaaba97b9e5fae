"""Many clips at once: jobs, worker processes or a Ray cluster, one folder a clip and a summary."""

from mjx_refine.many.jobs import Job, jobs_of_pairs, load_jobs
from mjx_refine.many.outcome import Outcome
from mjx_refine.many.progress import ManyProgress
from mjx_refine.many.run import ENGINES, Many, refine_many

__all__ = ["ENGINES", "Job", "Many", "ManyProgress", "Outcome", "jobs_of_pairs", "load_jobs", "refine_many"]
