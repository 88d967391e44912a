"""The declared machine in the pages of all reports: pictures and table."""
