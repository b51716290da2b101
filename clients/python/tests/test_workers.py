"""Errors of environments in worker processes, which `AsyncVectorEnv` formats and recreates."""

import ast
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from environments import WILDFIRE, closed_later, make, serving
from failures import fails
from gymnasium.vector import AsyncVectorEnv

import emberwatch
from emberwatch import errors

PACKAGE = Path(emberwatch.__file__).parent


def workers(**keywords: Any) -> AsyncVectorEnv:
    made = AsyncVectorEnv([make_later(world=world, **keywords) for world in range(2)])
    return closed_later(made)


def make_later(**keywords: Any) -> Callable[[], Any]:
    # Spawned workers know an id only with its package.
    return lambda: gymnasium.make(f"emberwatch:{WILDFIRE}", **keywords)


@pytest.fixture(autouse=True)
def quiet() -> Any:
    """Ignores Gymnasium's warnings about errors of workers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def test_a_refusal_in_a_worker_keeps_its_code_and_detail() -> None:
    with serving(worlds=2) as instance:
        holder = make(instance=instance)
        holder.reset()
        with emberwatch.connect(instance) as client:
            pid = client.status().worlds[0].holder_pids[0]
        with fails("busy") as raised:
            workers(instance=instance).reset(seed=1)
        assert raised.value.detail == pid
    with serving(worlds=2, max_steps=1) as instance:
        envs = workers(instance=instance, disable_env_checker=True)
        envs.reset(seed=1)
        envs.step(envs.action_space.sample())
        with emberwatch.connect(instance) as client:
            client.acquire(0, 2, takeover=True)
            with pytest.raises(errors.LeaseLostError) as raised:
                envs.step(envs.action_space.sample())
        assert raised.value.code == "lease_lost" and raised.value.detail > 0


def test_a_recreated_error_is_the_same() -> None:
    for error in (
        errors.LeaseLostError("lost", detail=3),
        errors.RequestTimeoutError("late"),
        errors.invalid("action", 4, 5),
        errors.refusal(10, 77),
    ):
        for again in (type(error)(error), pickle.loads(pickle.dumps(error))):  # type: ignore
            assert (type(again), str(again)) == (type(error), str(error))
            assert (again.code, again.detail) == (error.code, error.detail)


def test_no_traceback_line_has_a_percent_sign() -> None:
    # `AsyncVectorEnv` formats the traceback with `%`, so a percent sign would hide the error.
    raised = [PACKAGE / "envs", PACKAGE / "client"]
    for path in [*PACKAGE.glob("*.py"), *(it for folder in raised for it in folder.rglob("*.py"))]:
        lines = path.read_text().splitlines()
        for node in ast.walk(ast.parse(path.read_text())):
            is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            if isinstance(node, ast.stmt | ast.Call | ast.BinOp) and not is_docstring:
                assert "%" not in lines[node.lineno - 1], f"{path.name}:{node.lineno}"
