"""Whole rollouts in one kernel: a warp of an NVIDIA GPU simulates one candidate from its first frame to its last.

MJX-Warp takes 134 kernels a step, each of 6 us whether it has one candidate or a thousand, so a single clip's candidates wait
for launches. Here nothing is launched within a rollout, and what the lanes of a warp exchange stays in shared memory.

The contact points are those of ``mjx_refine.sim.colliders``, the solver is Newton's with elliptic cones, as C MuJoCo's, in
single precision. It is for searches, whose results C MuJoCo simulates and scores again. The source is C++, so that it can
say which lane does what, and the same source runs on a CPU as one lane, for tests.
"""

LARGEST = 8
"""Objects up to which a candidate's state fits into the shared memory that every block has."""
