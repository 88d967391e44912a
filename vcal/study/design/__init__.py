"""The table `[design]` of a study: its task, the plan it writes, effects to tell apart."""
