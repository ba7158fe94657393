"""Place: put an object on another support than the one it stands on."""

from simrecon_envs.tasks.base import Info
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec


class Place(Carry):
    """The support carries the object, which rests, and nobody holds it."""

    kind = "place"
    joint = "_on_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        supports = [key for key in facts.carriers if key not in facts.movable]
        return [
            (target.id, place)
            for target in facts.ranked
            for place in supports
            if place not in (target.id, facts.parent.get(target.id))
        ]

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Place the {facts.thing(spec.subject)} on the {facts.thing(spec.place)}."

    def _arrived(self) -> Info:
        return {"is_there": self.env.measures.supported(self.subject, self.spec.place)}
