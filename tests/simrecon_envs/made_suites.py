"""A small suite's options, and a generation that is killed half-way."""

from simrecon_envs.benchmark.generate import GenerateConfig
from simrecon_envs.benchmark.records import Records

SUITE_CONFIG = GenerateConfig(kinds=("reach", "pick"), robots=("panda",), per_scene=3, seeds=2)


class Killed(BaseException):
    """What a kill is to a test."""


class DyingRecords(Records):
    """Keeps so many records, then the process "dies"."""

    left = 2

    def put(self, key: object, record: dict) -> None:
        if not self.left:
            raise Killed
        self.left -= 1
        super().put(key, record)
