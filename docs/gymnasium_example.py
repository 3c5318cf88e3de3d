"""An agent of your own, for the suction cup: `python docs/gymnasium_example.py`."""

import gymnasium
import numpy as np
from scipy import ndimage


def flat_and_high(observation: dict[str, np.ndarray], size: int = 9, margin: int = 8) -> tuple[int, int, int]:
    """Angle's index, row and column of the pixel whose surroundings are high, and all of one height."""
    mean = ndimage.uniform_filter(observation["height"], size)
    roughness = ndimage.maximum_filter(observation["height"], size) - ndimage.minimum_filter(observation["height"], size)
    score = (mean - 5 * roughness)[margin:-margin, margin:-margin]
    row, col = np.unravel_index(score.argmax(), score.shape)
    return 0, int(row) + margin, int(col) + margin


def main(episodes: int = 2) -> float:
    """Success rate over some bins of unseen objects."""
    env = gymnasium.make("see2act.environment:see2act/BinPicking-v1", overrides=["primitive=suction"], split="unseen")
    rewards = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        done = False
        while not done:
            observation, reward, terminated, truncated, info = env.step(flat_and_high(observation))
            rewards.append(reward)
            print(f"bin {episode}, pick {len(rewards)}: {info['cause']}")
            done = terminated or truncated
    env.close()
    return float(np.mean(rewards))


if __name__ == "__main__":
    print(f"{main():.2f} of the picks succeeded")
