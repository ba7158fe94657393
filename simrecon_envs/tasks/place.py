"""Place: put an object on a support other than its present one."""

from simrecon_envs.tasks.base import Info, Pair
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts


class Place(Carry):
    """Success: the support carries the object, which is at rest and not held."""

    kind = "place"
    sentence = "Place the {subject} on the {place}."
    joint = "_on_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return each movable object with each fixed support other than its own."""
        supports = [key for key in facts.carriers if key not in facts.movable]
        return [
            (target.id, place)
            for target in facts.ranked
            for place in supports
            if place not in (target.id, facts.parent.get(target.id))
        ]

    def _arrived(self) -> Info:
        return {"is_there": self.env.measures.supported(self.subject, self.place)}
