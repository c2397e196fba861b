"""What a capture will do, known before it begins: viewpoints, reachable order, duration."""
