"""Effects and instruments in a user's own files, each method called once before it is used."""
