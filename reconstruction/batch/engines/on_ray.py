"""Engine on Ray: a task for each video, on this machine or on a cluster.

Ray places the tasks by CPU cores, GPUs and memory. The driver, not Ray, repeats attempts, because only it can tell the
video's fault from the machine's. A task that failed for a machine's fault is kept off that machine if there are others.
"""

from dataclasses import replace
from importlib import import_module
from typing import Any

from reconstruction.batch.attempt import Job, run_attempt
from reconstruction.batch.engines.base import Resources
from reconstruction.batch.outcomes import CURES, Outcome, plain
from registry.errors import EnvironmentMissing

_OBJECT_STORE_BYTES = 100 << 20  # results are small
_STOP_S = 45.0


def _run_on_node(job: Job) -> tuple[str, Outcome]:
    """Run an attempt; return the id of the node, too."""
    ray = import_module("ray")
    return ray.get_runtime_context().get_node_id(), run_attempt(job)


class RayEngine:
    """Runs jobs as tasks of a local Ray, or of the cluster at `resources.address`."""

    name = "ray"

    def __init__(self, resources: Resources) -> None:
        try:
            ray = import_module("ray")
        except ImportError as error:
            raise EnvironmentMissing("--engine ray needs Ray: pip install 'simrecon[ray]'") from error
        self._ray: Any = ray
        self._running: dict[Any, Job] = {}
        self._at_once = resources.at_once
        self._is_cluster = resources.address is not None
        options: dict[str, Any] = {
            "log_to_driver": False,
            "logging_level": "ERROR",
            "configure_logging": False,
        }
        if resources.address is None:
            options |= {
                "address": "local",
                "num_cpus": len(resources.usable_cores()),
                "include_dashboard": False,
                "object_store_memory": _OBJECT_STORE_BYTES,
            }
        else:
            options["address"] = resources.address
        try:
            ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            raise EnvironmentMissing(
                f"--engine ray: cannot reach {resources.address or 'a local Ray'}: {plain(str(error))}. "
                "`ray status` tells whether the cluster runs"
            ) from error
        self._task = ray.remote(_run_on_node)
        self.places = 1

    def _places_of(self, job: Job) -> int:
        total = self._ray.cluster_resources()
        places = int(total.get("CPU", 0) // max(1, job.cores))
        if job.gpus:
            places = min(places, int(total.get("GPU", 0) // job.gpus))
        if job.memory_mb:
            places = min(places, int(total.get("memory", 0) // (job.memory_mb << 20)))
        return max(1, min(places, self._at_once) if self._at_once else places)

    def room(self, job: Job) -> bool:
        """See `Engine.room`. A cluster also gets a queue as long as what it runs, which makes it grow if it can."""
        self.places = self._places_of(job)
        queued = self.places if self._is_cluster and not self._at_once else 0
        return len(self._running) < self.places + queued

    def start(self, job: Job) -> None:
        """See `Engine.start`."""
        options: dict[str, Any] = {
            "num_cpus": job.cores,
            "num_gpus": job.gpus,
            "memory": job.memory_mb << 20,
            "max_retries": 0,
            "name": f"simrecon {job.scene_id}",
        }
        others = {node["NodeID"] for node in self._ray.nodes() if node["Alive"]} - set(job.avoid)
        if job.avoid and others:
            strategies = import_module("ray.util.scheduling_strategies")
            elsewhere = {"ray.io/node-id": strategies.NotIn(*job.avoid)}
            options["scheduling_strategy"] = strategies.NodeLabelSchedulingStrategy(hard=elsewhere)
        self._running[self._task.options(**options).remote(job)] = job

    def finished(self, timeout_s: float) -> list[tuple[Job, Outcome]]:
        """See `Engine.finished`."""
        references = list(self._running)
        if not references:
            return []
        ready, _ = self._ray.wait(references, num_returns=1, timeout=timeout_s)
        if ready:
            ready, _ = self._ray.wait(references, num_returns=len(references), timeout=0)
        return [(self._running.pop(reference), self._outcome(reference)) for reference in ready]

    def _outcome(self, reference: Any) -> Outcome:
        """Return the outcome of an ended task; a lost worker or machine is the machine's fault."""
        errors = self._ray.exceptions
        try:
            node, outcome = self._ray.get(reference)
        except errors.TaskCancelledError:
            return Outcome("interrupted", "interrupted", CURES["interrupted"])
        except errors.OutOfMemoryError as error:
            return Outcome("memory", plain(str(error)), CURES["memory"])
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.RayActorError) as error:
            return Outcome("killed", plain(f"the worker died: {error}"), CURES["killed"])
        except errors.RayTaskError as error:
            return Outcome("bug", plain(str(error).strip().splitlines()[-1]), CURES["bug"])
        except errors.RayError as error:
            return Outcome("machine", plain(str(error)), CURES["machine"])
        return replace(outcome, node=node)

    def stop(self) -> None:
        """See `Engine.stop`."""
        for reference in self._running:
            self._ray.cancel(reference, force=False)

    def close(self) -> None:
        """See `Engine.close`."""
        self.stop()
        if self._running:
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=_STOP_S)
        self._ray.shutdown()
