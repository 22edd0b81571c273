"""The reward: names and levels of its terms, where each number comes from, and whether they add
up.
"""
