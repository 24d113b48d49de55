"""One module for each environment: its mathematics as a :class:`~filtergym.envs.task.Task`."""
