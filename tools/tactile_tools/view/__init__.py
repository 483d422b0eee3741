"""The live page: what boards feel and how a reach goes, in a browser; logs too."""
