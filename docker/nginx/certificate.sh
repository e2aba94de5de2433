#!/bin/sh
# SPDX-License-Identifier: MIT
# Writes server.pem and server.key into this folder, for clients that call this machine NAME or IP, and checks them. The
# authority in ca.pem and ca.key signs them; if there is none, it is made.
#
#   certificate.sh NAME IP
set -eu
umask 077
name=$1 ip=$2

if [ -e ca.pem ] && [ ! -e ca.key ]; then
  echo "certificate.sh: ca.pem is here without ca.key, which signs: bring ca.key back" >&2
  exit 1
fi
[ -e ca.pem ] || openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 \
  -subj "/CN=authority of $name" -addext keyUsage=critical,keyCertSign,cRLSign -keyout ca.key -out ca.pem
openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" -keyout server.key -out server.csr
printf '%s\n' "subjectAltName=DNS:$name,IP:$ip" basicConstraints=critical,CA:FALSE keyUsage=critical,digitalSignature \
  extendedKeyUsage=serverAuth authorityKeyIdentifier=keyid subjectKeyIdentifier=hash > server.ext
openssl x509 -req -in server.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 825 -extfile server.ext -out server.pem
openssl verify -CAfile ca.pem -purpose sslserver -verify_hostname "$name" server.pem
openssl verify -CAfile ca.pem -purpose sslserver -verify_ip "$ip" server.pem
