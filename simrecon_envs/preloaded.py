"""The simulator, loaded and frozen out of garbage collection: a fork server imports this module before it forks."""

from simrecon_envs.processes import prepare_process

prepare_process()
