"""A model file with any number of states and observations."""


def write_model(path, n_states, n_observations):
    """Writes a model of states that never change, each observed as its own values alone."""
    lines = ['name = "made"', "kernel_size = [1, 1]"]
    share = n_observations // n_states
    for state in range(n_states):
        seen = [float(value // share == state) / share for value in range(n_observations)]
        lines += ["[[states]]", f'name = "state-{state}"', f'color = "#8080{16 * state:02x}"']
        lines += [f"initial = {1 / n_states}", f"reward = {float(state == 0)}"]
        lines += [f"observed_as = {seen}"]
    for value in range(n_observations):
        lines += ["[[observations]]", f'name = "kind {value}"', f'color = "#8080{16 * value:02x}"']
    for state in range(n_states):
        lines += ["[[kernel]]", f'from = "state-{state}"', f'to = "state-{state}"']
        lines += ["scale = 1.0", "weights = [[1.0]]"]
    path.write_text("\n".join(lines))
    return path
