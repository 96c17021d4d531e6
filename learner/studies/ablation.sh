#!/usr/bin/env bash
# What each departure of the preset `quick` from `paper` buys: one run per variant and environment, two at a time.
#   learner/studies/ablation.sh DIR      (after `make build`; runs that are complete are not repeated)
set -euo pipefail
out=${1:?usage: $0 DIR}
learner="$(dirname "${BASH_SOURCE[0]}")/../../target/release/learner"

envs="RepeatPreviousEasy StatelessPendulumEasy NoisyStatelessCartPoleEasy MultiarmedBanditEasy MineSweeperEasy LabyrinthExploreEasy"
# A name, then `quick` with these keys as in `paper`.
variants="quick
batch --batch-steps 65536 --minibatch-steps 8192
gamma --gamma 0.99
lambda --gae-lambda 1.0
value --value-clip 10 --value-coef 1.0
kl --kl-coef 0.2
rate --learning-rate 5e-5
adam --max-grad-norm 0 --adam-epsilon 1e-8
scale --reward-scale 1.0
limit --bootstrap-at-truncation false
fixed --minibatches fixed
passes --passes 30
paper --preset paper"

while read -r name flags; do
    for env in $envs; do
        echo "--env $env --out $out/$name-$env --steps 200000 --threads 1 --actors 1 --continue $flags"
    done
done <<<"$variants" | xargs -P 2 -I{} sh -c "'$learner' train {} </dev/null >>'$out.log' 2>&1 && echo '{}'"
