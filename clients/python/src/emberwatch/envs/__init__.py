"""The environments for Gymnasium and PettingZoo."""

from emberwatch.envs.moves_env import WildfireMovesEnv as WildfireMovesEnv
from emberwatch.envs.moves_env import WildfireMovesVectorEnv as WildfireMovesVectorEnv
from emberwatch.envs.objective_env import WildfireObjectiveEnv as WildfireObjectiveEnv
from emberwatch.envs.objective_env import WildfireObjectiveVectorEnv as WildfireObjectiveVectorEnv
from emberwatch.envs.path_env import WildfireEnv as WildfireEnv
from emberwatch.envs.path_env import WildfireVectorEnv as WildfireVectorEnv
