"""OAK cameras, host-only: the library's own messages, queues and Sync, and sensors that play a stage."""
