"""Built-in sensors and metrics. They use only what a stranger's plugin can use."""
