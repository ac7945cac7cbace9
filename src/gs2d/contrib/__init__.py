"""Parts that the core works without, registered through the extension points that plug-ins use."""
