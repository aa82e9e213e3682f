"""Write a first description for any model of a legged robot, and make its guesses again."""
