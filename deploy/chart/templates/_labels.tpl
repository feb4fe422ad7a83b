{{- define "plantd.labels" -}}
app.kubernetes.io/name: plantd
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}
{{- define "plantd.isClosed" -}}
{{- if and (not .Values.insecure) (or (not .Values.tls.secret) (not .Values.auth.secret)) -}}
{{- fail "others can reach these servers: name `tls.secret` and `auth.secret`, or set `insecure: true` where the network is closed to strangers" -}}
{{- end -}}
{{- end }}
