"""Stage folders on disk: whole or absent, readable by people, digested by content."""
