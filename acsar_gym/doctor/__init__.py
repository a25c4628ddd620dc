"""What a robot, its wire and its host are like: checks that say what to do."""
