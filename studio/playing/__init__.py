"""Playing a scene in the page: live physics, the assembly step by step, rollouts of tasks."""
