"""What all reports share: the page system, pictures, provenance and the folder."""
