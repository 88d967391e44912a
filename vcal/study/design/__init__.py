"""The table ``[design]`` of a study: its design task, the written plan, two effects to separate."""
