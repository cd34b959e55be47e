"""The race: gr-ros2, DDS and Zenoh carry the same recording over the same simulated radio, and are measured alike."""
