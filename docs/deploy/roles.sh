#!/bin/sh
# Makes the two roles and the database of a site, once, in a new PostgreSQL server, as a superuser.
set -eu
secrets=${SECRETS:-/run/secrets}
psql --no-psqlrc --quiet --set ON_ERROR_STOP=1 --username "$POSTGRES_USER" --dbname postgres \
    --set owner="$(cat "$secrets/owner_password")" --set program="$(cat "$secrets/program_password")" << 'SQL'
CREATE ROLE orthocapture_owner LOGIN PASSWORD :'owner';
CREATE ROLE orthocapture LOGIN PASSWORD :'program';
CREATE DATABASE orthocapture OWNER orthocapture_owner;
SQL
