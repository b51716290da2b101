"""Model files with any number of states and observations."""


def model_file(
    states: dict[str, tuple[float, float, list[float]]],
    observations: list[str],
    weights: list[list[float]],
    scales: dict[tuple[str, str], float],
) -> str:
    """Returns a model file. States have an initial probability, a reward, and observation weights.

    The kernel between two states is `weights` times the pair's scale.
    """
    lines = ['name = "made"', f"kernel_size = {[len(weights), len(weights[0])]}"]
    for number, (name, (initial, reward, observed_as)) in enumerate(states.items()):
        lines += ["[[states]]", f'name = "{name}"', f'color = "#8080{16 * number:02x}"']
        lines += [f"initial = {initial}", f"reward = {reward}", f"observed_as = {observed_as}"]
    for number, name in enumerate(observations):
        lines += ["[[observations]]", f'name = "{name}"', f'color = "#8080{16 * number:02x}"']
    for (source, target), scale in scales.items():
        lines += ["[[kernel]]", f'from = "{source}"', f'to = "{target}"']
        lines += [f"scale = {scale}", f"weights = {weights}"]
    return "\n".join(lines)
