"""Whether this process can use what it inherited: neither JAX nor MuJoCo's threads survive a fork."""

import os
import sys


def _jax_began():
    """Whether JAX has begun its threads in this process or, before a fork, in the process that this one comes from."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


def _one_thread():
    """Whether this process has a single thread, where that can be told."""
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


_forked_from_jax = _jax_began() and _one_thread()  # a fork before this module was imported took JAX's threads


def _note():
    global _forked_from_jax
    _forked_from_jax = _forked_from_jax or _jax_began()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note)


def refuse(made: int | None = None) -> None:
    """Raises RuntimeError in a process that can't go on: it would wait for ever for threads that are not there.

    Such a process was forked after JAX began its threads, or after the process with the id `made` made the object that
    is to be used.
    """
    if _forked_from_jax or made not in (None, os.getpid()):
        raise RuntimeError(
            "This process was forked after its parent had used JAX or made this environment, and neither survives "
            "that. Use processes by spawn (context='spawn'), or gymnasium.make_vec(id, num_envs=N), which needs no "
            "processes."
        )
