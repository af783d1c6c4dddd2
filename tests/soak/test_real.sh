#!/usr/bin/env bash
# tests/http/test_real.sh with the whole abdomen before the whole panel.
ABDOMEN=whole exec bash "$(dirname "$0")/../http/test_real.sh"
