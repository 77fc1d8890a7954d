#!/usr/bin/env bash
# Train by the paper's protocol (Vu et al., Sec. V), as far as it is stated. This takes days.
#
#     benchmark/paper.sh mppo_beta            # or ppo, trpo, recurrent_ppo
#     benchmark/paper.sh ppo --threads 16     # further arguments go to the script
#     benchmark/paper.sh ppo --resume runs/<run>
#     benchmark/paper.sh ppo --total-timesteps 84000 --final-trials 1    # does it work?
#
# The paper took 21.5 hours for mPPO and PPO, 56 for TRPO and 92.3 for recurrent PPO, with 64 cores
# and a GPU. It states: the task ForestryCranePaper-v0 with steps of 5 ms, 42 cranes, 500 million
# steps, 1,000 steps per crane and rollout, 4 layers of 256 neurons, Adam with 3e-4, 30 epochs, and
# perturbations of up to 0.1 in mPPO.
#
# The rest are guesses: gamma, lambda and the clip range (the defaults of Stable-Baselines3, with
# which the paper trained), minibatches, reward scale, weights of the losses, bound of the gradient,
# tanh units, normalization, the policy's first width, the LSTM, and TRPO's settings. sb3-contrib
# takes the mean KL divergence over the six components of the action, we take the sum: its target_kl
# 0.01 and damping 0.1 are six times as large here. The learning rate falls to 0, and so does the
# bound of TRPO. The perturbation of mPPO falls to 0 in the first 40 % of the run. The paper says
# none of this.
#
# A new policy's noise changes at every step. In steps of 5 ms it jerks the ideal servos so hard that
# `overspeed` ends nearly all first episodes, half of them within 0.05 s.
set -euo pipefail
cd "$(dirname "$0")/.."

algorithm=${1:?mppo_beta, ppo, trpo or recurrent_ppo}
shift
flags=(
    --env-id ForestryCranePaper-v0 --curriculum 0 --retry 0 --horizon-growth 1 --narrowing 0
    --total-timesteps 500000000 --num-envs 42 --num-steps 1000 --hidden-sizes 256 256 256 256
    --learning-rate 3e-4 --update-epochs 30 --gamma 0.99 --gae-lambda 0.95 --reward-scale 0.01
)
case $algorithm in
    mppo_beta) flags+=(--minibatch-size 2000 --target-kl 1e9 --log-excess-init 0) ;;
    ppo) flags+=(--minibatch-size 2000 --target-kl 1e9 --log-std-init -0.5) ;;
    trpo) flags+=(--minibatch-size 2000 --target-kl 0.06 --cg-damping 0.6 --fisher-samples 42000 --log-std-init -0.5) ;;
    recurrent_ppo) flags+=(--num-minibatches 21 --target-kl 1e9 --log-std-init -0.5) ;;
esac
exec "${PYTHON:-.venv/bin/python}" "${algorithm}_crane.py" "${flags[@]}" "$@"
