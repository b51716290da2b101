"""Evaluation of Python policies on the benchmark's worlds.

    rows = evaluate(policy, name="ppo", seeds=range(32), csv="ppo.csv", model="wildfire-small", ...)

`emberwatch-agent compare --add ppo.csv`, run with the same worlds and steps, adds these rows to its
table and pairs them by world.
"""

from emberwatch._native import FIRST_TRAINING_SEED as FIRST_TRAINING_SEED
from emberwatch.benchmark.evaluation import evaluate as evaluate
from emberwatch.benchmark.policies import Policy as Policy
from emberwatch.benchmark.rows import Row as Row
from emberwatch.benchmark.rows import read as read
from emberwatch.benchmark.rows import summary as summary
from emberwatch.benchmark.suite import suite as suite
