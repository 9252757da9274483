"""What is run: configurations, and the one place where a run's parts are put together."""
