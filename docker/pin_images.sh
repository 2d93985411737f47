#!/usr/bin/env bash
# Write the images that compose.yaml and the Dockerfile start from to docker/.env, each by the digest that its tag has now:
#   bash docker/pin_images.sh
# Tags move, digests do not: run it on purpose, read what changed, keep the file. Other lines of docker/.env stay.
set -euo pipefail
cd "$(dirname "$0")"

pinned=$(mktemp)
trap 'rm -f "$pinned"' EXIT
if [ -f .env ]; then grep -vE '^HELIOTWIN_[A-Z]+_IMAGE=' .env >"$pinned" || true; fi
while read -r variable image; do
  docker pull --quiet "$image" >/dev/null
  digest=$(docker image inspect --format '{{index .RepoDigests 0}}' "$image")
  echo "$variable=$digest" >>"$pinned"
done < <(grep -ohE '\$\{HELIOTWIN_[A-Z]+_IMAGE:-[^}]+\}' compose.yaml | sort -u | sed -E 's/\$\{([A-Z_]+):-(.+)\}/\1 \2/')
cp "$pinned" .env
