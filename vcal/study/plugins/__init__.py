"""Effects and instruments in files of the user's own, tried once before they are used."""
