#!/bin/sh
# Writes the folder `secrets` for compose.yaml: passwords, keys of the object store. Certificates come from elsewhere.
# As root, it gives the files of the program to the user of its containers.
set -eu
umask 077
folder=${1:-secrets}
mkdir "$folder" # which must not exist: nothing is overwritten
random() { head -c 24 /dev/urandom | base64 | tr '+/' '-_'; }

random > "$folder/postgres_password"
random > "$folder/owner_password"
random > "$folder/program_password"
{
    echo "*:*:*:orthocapture_owner:$(cat "$folder/owner_password")"
    echo "*:*:*:orthocapture:$(cat "$folder/program_password")"
} > "$folder/pgpass"

access=$(random)
secret=$(random)
printf 'access_key_id: "%s"\nsecret_access_key: "%s"\n' "$access" "$secret" > "$folder/store_keys.yaml"
cat > "$folder/seaweedfs_keys.json" << JSON
{"identities": [{"name": "orthocapture", "actions": ["Admin", "Read", "Write", "List", "Tagging"],
  "credentials": [{"accessKey": "$access", "secretKey": "$secret"}]}]}
JSON
# Servers read theirs as users of their own: the folder, which is root's alone, protects them on this machine.
chmod 0444 "$folder"/*_password "$folder/seaweedfs_keys.json"
if [ "$(id -u)" = 0 ]; then
    chown 10001 "$folder/pgpass" "$folder/store_keys.yaml"
fi
