"""The run, for any agent: collect, learn, evaluate, record."""
