"""A brute-force account of a replay and its episodes."""


def played(done, replay_capacity):
    """The finished episodes as tuples of their transitions, and the transition in each row."""
    rows, finished, running = [None] * replay_capacity, [], ()
    for number, ended in enumerate(done):
        rows[number % replay_capacity] = number
        running += (number,)
        if ended:
            finished, running = [*finished, running], ()
    return finished, rows
